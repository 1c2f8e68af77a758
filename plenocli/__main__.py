from plenocli.cli.main import main

main()
